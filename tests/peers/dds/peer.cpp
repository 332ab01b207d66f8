// An independent DDS peer under a test's hand: `peer DOMAIN`, then commands on standard input, one a line.
//
//   pub ID TOPIC TYPE [QOS...]        a writer; QOS: reliable, transient_local, depth=N, deadline_ms=N, lifespan_ms=N,
//   sub ID TOPIC TYPE [QOS...]        a reader             userdata=TEXT; `quiet` (reader): only count and measure
//   write ID HEX                      deserialise CDR bytes into the type, and write it
//   flood ID HEX HZ COUNT             write it COUNT times, stamped (header.stamp) with the wall clock, from a thread
//   stats ID                          count and delays of a quiet reader, which begins anew
//   serve ID SERVICE [QOS...]         a std_srvs/SetBool server as rmw_cyclonedds has it; answers with the argument
//   close ID | crash | (end of input: an orderly exit)
//
// It says: `guid HEX`, `done COMMAND`, `got ID HEX STAMP_NS`, `matched ID COUNT`, `incompatible ID POLICY`,
// `flooded ID`, `stats ID COUNT NS,NS,...`. It speaks UDP on loopback only, and no multicast.
#include <atomic>
#include <chrono>
#include <cstdio>
#include <ctime>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include "PeerPubSubTypes.h"

using namespace eprosima::fastdds::dds;
using eprosima::fastdds::rtps::UDPv4TransportDescriptor;
using eprosima::fastrtps::rtps::IPLocator;
using eprosima::fastrtps::rtps::Locator_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

static std::mutex out_mutex;

static void say(const std::string& line) {
    std::lock_guard<std::mutex> lock(out_mutex);
    std::fwrite(line.data(), 1, line.size(), stdout);
    std::fputc('\n', stdout);
    std::fflush(stdout);
}

static int64_t wall_ns() {
    timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return int64_t(now.tv_sec) * 1000000000 + now.tv_nsec;
}

static std::string to_hex(const unsigned char* data, size_t size) {
    static const char digits[] = "0123456789abcdef";
    std::string text(2 * size, '0');
    for (size_t i = 0; i < size; ++i) {
        text[2 * i] = digits[data[i] >> 4];
        text[2 * i + 1] = digits[data[i] & 15];
    }
    return text;
}

static std::vector<unsigned char> from_hex(const std::string& text) {
    std::vector<unsigned char> bytes(text.size() / 2);
    for (size_t i = 0; i < bytes.size(); ++i) {
        bytes[i] = static_cast<unsigned char>(std::stoi(text.substr(2 * i, 2), nullptr, 16));
    }
    return bytes;
}

// What a type can do that this program needs of it.
struct Kind {
    TypeSupport support;
    void (*stamp)(void*, int64_t);
    int64_t (*stamped)(void*);
};

template <class T>
static void set_stamp(void* data, int64_t ns) {
    auto& stamp = static_cast<T*>(data)->header().stamp();
    stamp.sec(int32_t(ns / 1000000000));
    stamp.nanosec(uint32_t(ns % 1000000000));
}

template <class T>
static int64_t get_stamp(void* data) {
    auto& stamp = static_cast<T*>(data)->header().stamp();
    return int64_t(stamp.sec()) * 1000000000 + stamp.nanosec();
}

// Fast CDR leaves padding as it finds it: in a buffer that is used again, bytes of an earlier message.
template <class Base>
struct Clean : Base {
    using Base::serialize;
    bool serialize(void* data, SerializedPayload_t* payload) override {
        std::fill_n(payload->data, payload->max_size, 0);
        return Base::serialize(data, payload);
    }
};

template <class Type>
static Kind plain_kind() {
    return Kind{TypeSupport(new Clean<Type>()), nullptr, nullptr};
}

template <class T, class Type>
static Kind stamped_kind() {
    return Kind{TypeSupport(new Clean<Type>()), set_stamp<T>, get_stamp<T>};
}

static std::map<std::string, Kind> kinds() {
    std::map<std::string, Kind> all;
    auto add = [&all](Kind kind) { all[kind.support.get_type_name()] = kind; };
    add(plain_kind<std_msgs::msg::dds_::String_PubSubType>());
    add(plain_kind<diagnostic_msgs::msg::dds_::DiagnosticStatus_PubSubType>());
    add(plain_kind<std_srvs::srv::dds_::SetBool_Request_PubSubType>());
    add(plain_kind<std_srvs::srv::dds_::SetBool_Response_PubSubType>());
    using namespace example_interfaces::action::dds_;
    add(plain_kind<Fibonacci_SendGoal_Request_PubSubType>());
    add(plain_kind<Fibonacci_SendGoal_Response_PubSubType>());
    add(plain_kind<Fibonacci_GetResult_Request_PubSubType>());
    add(plain_kind<Fibonacci_GetResult_Response_PubSubType>());
    add(plain_kind<Fibonacci_FeedbackMessage_PubSubType>());
    add(plain_kind<action_msgs::srv::dds_::CancelGoal_Request_PubSubType>());
    add(plain_kind<action_msgs::srv::dds_::CancelGoal_Response_PubSubType>());
    add(plain_kind<action_msgs::msg::dds_::GoalStatusArray_PubSubType>());
    add(plain_kind<rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_PubSubType>());
    add(stamped_kind<nav_msgs::msg::dds_::Odometry_, nav_msgs::msg::dds_::Odometry_PubSubType>());
    add(stamped_kind<sensor_msgs::msg::dds_::PointCloud2_, sensor_msgs::msg::dds_::PointCloud2_PubSubType>());
    return all;
}

struct Settings {
    bool reliable = false, transient_local = false, quiet = false;
    int depth = 10;
    double deadline_ms = 0, lifespan_ms = 0;
    std::string userdata;
};

static Settings parse(std::istringstream& words) {
    Settings settings;
    std::string word;
    while (words >> word) {
        auto value = word.substr(word.find('=') + 1);
        if (word == "reliable") settings.reliable = true;
        else if (word == "transient_local") settings.transient_local = true;
        else if (word == "quiet") settings.quiet = true;
        else if (word.rfind("depth=", 0) == 0) settings.depth = std::stoi(value);
        else if (word.rfind("deadline_ms=", 0) == 0) settings.deadline_ms = std::stod(value);
        else if (word.rfind("lifespan_ms=", 0) == 0) settings.lifespan_ms = std::stod(value);
        else if (word.rfind("userdata=", 0) == 0) settings.userdata = value;
        else throw std::runtime_error("unknown setting " + word);
    }
    return settings;
}

static eprosima::fastrtps::Duration_t from_ms(double ms) {
    return eprosima::fastrtps::Duration_t(static_cast<long double>(ms / 1000.0));
}

template <class Qos>
static void apply(Qos& qos, const Settings& settings) {
    qos.reliability().kind = settings.reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
    qos.durability().kind = settings.transient_local ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
    qos.history().kind = KEEP_LAST_HISTORY_QOS;
    qos.history().depth = settings.depth;
    qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    if (settings.deadline_ms > 0) qos.deadline().period = from_ms(settings.deadline_ms);
    if (settings.lifespan_ms > 0) qos.lifespan().duration = from_ms(settings.lifespan_ms);
    qos.user_data().data_vec({settings.userdata.begin(), settings.userdata.end()});
}


struct Side : DataReaderListener, DataWriterListener {
    std::string id;
    Kind* kind = nullptr;
    Topic* topic = nullptr;
    DataReader* reader = nullptr;
    DataWriter* writer = nullptr;
    Side* replies = nullptr;  // of a server: where its answers go
    bool quiet = false;
    std::mutex mutex;
    std::vector<int64_t> delays_ns;
    std::thread flood;

    void on_data_available(DataReader* source) override {
        void* data = kind->support.create_data();
        SampleInfo info;
        while (source->take_next_sample(data, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            if (replies != nullptr) answer(data);
            else if (quiet) {
                int64_t delay_ns = wall_ns() - (kind->stamped ? kind->stamped(data) : 0);
                std::lock_guard<std::mutex> lock(mutex);
                delays_ns.push_back(delay_ns);
            } else {
                SerializedPayload_t payload(kind->support.get_serialized_size_provider(data)());
                kind->support.serialize(data, &payload);
                say("got " + id + " " + to_hex(payload.data, payload.length) + " " +
                    std::to_string(info.source_timestamp.to_ns()));
            }
        }
        kind->support.delete_data(data);
    }

    void answer(void* data) {
        auto* request = static_cast<std_srvs::srv::dds_::SetBool_Request_*>(data);
        std_srvs::srv::dds_::SetBool_Response_ response;
        response.guid(request->guid());
        response.seq(request->seq());
        response.success(request->data());
        response.message(request->data() ? "yes" : "no");
        // A server of rmw_cyclonedds waits for the reader of a client that has just appeared, too.
        PublicationMatchedStatus matched;
        for (int i = 0; i < 1000 && replies->writer->get_publication_matched_status(matched) == ReturnCode_t::RETCODE_OK
                 && matched.current_count == 0; ++i) {
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
        replies->writer->write(&response);
    }

    void on_subscription_matched(DataReader*, const SubscriptionMatchedStatus& status) override {
        say("matched " + id + " " + std::to_string(status.current_count));
    }
    void on_publication_matched(DataWriter*, const PublicationMatchedStatus& status) override {
        say("matched " + id + " " + std::to_string(status.current_count));
    }
    void on_requested_incompatible_qos(DataReader*, const RequestedIncompatibleQosStatus& status) override {
        say("incompatible " + id + " " + std::to_string(status.last_policy_id));
    }
    void on_offered_incompatible_qos(DataWriter*, const OfferedIncompatibleQosStatus& status) override {
        say("incompatible " + id + " " + std::to_string(status.last_policy_id));
    }
};

class Peer {
public:
    Peer(int domain, int lease_s) : kinds_(kinds()) {
        DomainParticipantQos qos;
        qos.name("peer");
        qos.transport().use_builtin_transports = false;
        auto udp = std::make_shared<UDPv4TransportDescriptor>();
        udp->interfaceWhiteList.push_back("127.0.0.1");
        udp->sendBufferSize = udp->receiveBufferSize = 4 << 20;
        qos.transport().user_transports.push_back(udp);
        Locator_t loopback;
        loopback.kind = LOCATOR_KIND_UDPv4;
        IPLocator::setIPv4(loopback, "127.0.0.1");
        qos.wire_protocol().builtin.initialPeersList.push_back(loopback);
        qos.wire_protocol().builtin.metatrafficUnicastLocatorList.push_back(loopback);
        qos.wire_protocol().builtin.discovery_config.leaseDuration = eprosima::fastrtps::Duration_t(lease_s, 0);
        qos.wire_protocol().builtin.discovery_config.leaseDuration_announcementperiod =
            eprosima::fastrtps::Duration_t(1, 0);
        participant_ = DomainParticipantFactory::get_instance()->create_participant(domain, qos);
        if (participant_ == nullptr) throw std::runtime_error("no participant");
        for (auto& item : kinds_) item.second.support.register_type(participant_);
        publisher_ = participant_->create_publisher(PUBLISHER_QOS_DEFAULT);
        subscriber_ = participant_->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
        std::ostringstream guid;
        guid << participant_->guid();
        say("guid " + guid.str());
    }

    ~Peer() {
        for (auto& item : entities_) remove(*item.second);
        entities_.clear();
        participant_->delete_contained_entities();
        DomainParticipantFactory::get_instance()->delete_participant(participant_);
    }

    void obey(const std::string& line) {
        std::istringstream words(line);
        std::string command, id;
        words >> command >> id;
        if (command == "crash") std::_Exit(3);
        if (command == "pub" || command == "sub") {
            std::string topic, type;
            words >> topic >> type;
            add(command == "pub", id, topic, type, parse(words));
        } else if (command == "serve") {
            std::string service;
            words >> service;
            Settings settings = parse(words);
            settings.reliable = true;
            auto& replies = add(true, id + "-reply", "rr/" + service + "Reply",
                                "std_srvs::srv::dds_::SetBool_Response_", settings);
            add(false, id, "rq/" + service + "Request", "std_srvs::srv::dds_::SetBool_Request_", settings, &replies);
        } else if (command == "write") {
            std::string hex;
            words >> hex;
            auto& entity = *entities_.at(id);
            void* data = sample(entity, hex);
            bool ok = entity.writer->write(data);
            entity.kind->support.delete_data(data);
            if (!ok) throw std::runtime_error("not written");
        } else if (command == "flood") {
            std::string hex;
            double hz;
            long count;
            words >> hex >> hz >> count;
            flood(*entities_.at(id), hex, hz, count);
        } else if (command == "stats") {
            auto& entity = *entities_.at(id);
            std::lock_guard<std::mutex> lock(entity.mutex);
            std::ostringstream text;
            text << "stats " << id << " " << entity.delays_ns.size() << " ";
            for (size_t i = 0; i < entity.delays_ns.size(); ++i) text << (i ? "," : "") << entity.delays_ns[i];
            entity.delays_ns.clear();
            say(text.str());
        } else if (command == "close") {
            remove(*entities_.at(id));
            entities_.erase(id);
        } else {
            throw std::runtime_error("unknown command " + command);
        }
        say("done " + command);
    }

private:
    Side& add(bool publishes, const std::string& id, const std::string& topic, const std::string& type,
                const Settings& settings, Side* replies = nullptr) {
        auto entity = std::make_unique<Side>();
        entity->id = id;
        entity->kind = &kinds_.at(type);
        entity->quiet = settings.quiet;
        entity->replies = replies;
        auto* known = participant_->lookup_topicdescription(topic);
        entity->topic = known ? static_cast<Topic*>(known) : participant_->create_topic(topic, type, TOPIC_QOS_DEFAULT);
        Side& added = *(entities_[id] = std::move(entity));
        if (publishes) {
            DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
            apply(qos, settings);
            qos.publish_mode().kind = SYNCHRONOUS_PUBLISH_MODE;
            added.writer = publisher_->create_datawriter(added.topic, qos, &added);
        } else {
            DataReaderQos qos = DATAREADER_QOS_DEFAULT;
            apply(qos, settings);
            added.reader = subscriber_->create_datareader(added.topic, qos, &added);
        }
        return added;
    }

    void* sample(Side& entity, const std::string& hex) {
        auto bytes = from_hex(hex);
        SerializedPayload_t payload(uint32_t(bytes.size()));
        std::copy(bytes.begin(), bytes.end(), payload.data);
        payload.length = uint32_t(bytes.size());
        void* data = entity.kind->support.create_data();
        if (!entity.kind->support.deserialize(&payload, data)) throw std::runtime_error("no such message");
        return data;
    }

    void flood(Side& entity, const std::string& hex, double hz, long count) {
        void* data = sample(entity, hex);
        entity.flood = std::thread([&entity, data, hz, count] {
            auto next = std::chrono::steady_clock::now();
            for (long i = 0; i < count; ++i) {
                std::this_thread::sleep_until(next);
                next += std::chrono::nanoseconds(int64_t(1e9 / hz));
                if (entity.kind->stamp) entity.kind->stamp(data, wall_ns());
                entity.writer->write(data);
            }
            entity.kind->support.delete_data(data);
            say("flooded " + entity.id);
        });
    }

    void remove(Side& entity) {
        if (entity.flood.joinable()) entity.flood.join();
        if (entity.reader) {
            entity.reader->set_listener(nullptr);
            subscriber_->delete_datareader(entity.reader);
        }
        if (entity.writer) {
            entity.writer->set_listener(nullptr);
            publisher_->delete_datawriter(entity.writer);
        }
    }

    std::map<std::string, Kind> kinds_;
    std::map<std::string, std::unique_ptr<Side>> entities_;
    DomainParticipant* participant_ = nullptr;
    Publisher* publisher_ = nullptr;
    Subscriber* subscriber_ = nullptr;
};

int main(int argc, char** argv) {
    if (argc != 3) {
        std::cerr << "usage: peer DOMAIN LEASE_S" << std::endl;
        return 2;
    }
    try {
        Peer peer(std::stoi(argv[1]), std::stoi(argv[2]));
        std::string line;
        while (std::getline(std::cin, line)) peer.obey(line);
    } catch (const std::exception& error) {
        say(std::string("failed ") + error.what());
        return 1;
    }
    return 0;
}
